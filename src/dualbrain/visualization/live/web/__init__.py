"""Web pages of the live view that do not depend on its 3D client: the bar with the state, and the text page."""
