"""The elastix engine: the one call of itk, and the parameters that it is given."""
