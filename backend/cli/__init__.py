"""The command line of `python -m backend`: options, help texts, exit codes and terminal output."""
