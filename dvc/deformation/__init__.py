"""What moves tissue: the Deformation protocol, its kinds, and the strain of a displacement gradient."""
