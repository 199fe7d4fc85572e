"""Transforms and displacement fields as files: elastix, ITK, displacement images and interface splines."""
