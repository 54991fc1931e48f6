"""The three-stage gate (syntax, authorization, envelope) that checks every contract."""
