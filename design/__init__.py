"""Offline design: PDE to PIE to LPI to gains artefact. Never imported by node, plant or recorder."""
