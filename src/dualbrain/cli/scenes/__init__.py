"""Commands about scenes: list the families, show one scene, arrange a new one."""
