"""The recorder: writes everything that crosses a process boundary to one MCAP file."""
