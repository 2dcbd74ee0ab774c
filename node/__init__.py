"""One arm segment: the sweep mathematics (pure) and the process around it."""
