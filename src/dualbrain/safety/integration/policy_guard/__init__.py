"""A guard between any policy and its robot: every action becomes the closest safe one in the layout of the policy."""
