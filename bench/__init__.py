"""The benchmark: the chain of neighbours against other exchange patterns, measured side by side."""
