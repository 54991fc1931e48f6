"""The compared filters: dualbrain, cbfpy, mink, pink, and a fake filter for tests."""
