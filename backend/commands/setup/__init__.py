"""Setup of the machine: the command `doctor`, kernel compilation, threads and memory."""
