"""Value model: which named alternative is worth most in a scene, learned from executed siblings."""
