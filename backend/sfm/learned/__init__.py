"""Features and matches by networks, of folders with a checkpoint of the package transformers."""
