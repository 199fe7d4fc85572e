"""Tissues of the unloaded image, labelled from the image itself and the mask of its bone."""
