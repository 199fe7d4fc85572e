"""Files in and out: images, meshes, transforms, and the folder of results."""
