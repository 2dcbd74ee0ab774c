"""Starts, watches and ends the processes of a run; the launcher's hands and eyes."""
