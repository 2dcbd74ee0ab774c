"""The emulated arm: finite-difference mathematics (pure) and the process around it."""
