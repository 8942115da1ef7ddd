"""The loss of a view, on the CPU and on a GPU."""
