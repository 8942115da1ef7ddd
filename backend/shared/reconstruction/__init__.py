"""The files of a reconstruction folder: one module per file defines its name and format."""
