"""Editor of table scenes: a page on the loopback address in which objects are dragged."""
