"""Reads recordings: summaries, the comparison with the centralised run, plots."""
