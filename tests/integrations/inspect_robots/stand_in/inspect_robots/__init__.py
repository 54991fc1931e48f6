"""Stand-in for inspect-robots 0.60.0: the names, fields and signatures that the connector uses, and nothing else.

`check_package.py` compares it with the installed package.
"""
