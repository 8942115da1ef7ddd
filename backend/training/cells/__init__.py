"""Training of a large model in cells, one after another or on several machines."""
