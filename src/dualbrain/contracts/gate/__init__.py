"""Three-stage gate (syntax, authorization, envelope) that checks every contract (paper 3.3)."""
