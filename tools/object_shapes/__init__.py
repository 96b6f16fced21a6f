"""Solids of the ten objects, built by constructive geometry to true sizes (metres, z up)."""
