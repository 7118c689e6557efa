"""Tubes: meshes and centrelines from files, generated curves, and batched geometric queries."""
