"""Files in and out: images, meshes, transforms, and the folder of results."""

from os import PathLike

StrPath = str | PathLike[str]
