"""Gains artefact to per-node sweep factors."""
