"""Safe readers of the mesh files and the XML of robot descriptions."""
