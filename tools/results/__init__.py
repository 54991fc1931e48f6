"""Pages of the committed results: recomputed tables, and the figures of the front page."""
