"""`register` and `strain`: from images or transforms to a folder of strain maps with error bars and a report."""
