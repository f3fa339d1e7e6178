"""Figures of CHIME."""
def figures(room, rows, tables): return {}
