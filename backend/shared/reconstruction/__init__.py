"""The reconstruction folder: one module for each of its files, which alone knows the file's name and shape."""
