"""Report of an evaluation: charts, HTML file, Markdown page."""
