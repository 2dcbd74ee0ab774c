"""Faults put into real runs, and what must be true afterwards."""
