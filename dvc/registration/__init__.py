"""From two images to the deformation between them: alignment on bone, then one of the engines."""
