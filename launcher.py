"""The command line of octarm."""


def main() -> None:
    """Entry point, see `octarm --help`."""
