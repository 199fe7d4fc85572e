"""A pair of images as a measurement: deformation, strain maps, quality, verdict, error bars; written, read, shown."""
