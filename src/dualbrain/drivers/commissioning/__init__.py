"""The commissioning checklist that enables a real arm, and its signed record."""
