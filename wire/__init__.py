"""Everything that crosses a process or file boundary: messages, sessions, artefact, recording channels."""
