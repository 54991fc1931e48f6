"""The commissioning checklist of a real arm, and the record without which no hardware is opened."""
