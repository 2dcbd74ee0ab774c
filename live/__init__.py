"""A page that shows the running arm: a client of the router that reads telemetry, never on the control path."""
