"""Images on a grid in space, and what their values alone tell: tissue, bias field, noise and similarity."""
