"""The command line of `python -m backend`: options, help texts and exit codes."""
