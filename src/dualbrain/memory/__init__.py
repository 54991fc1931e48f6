"""What happened: the event ledger, the joint embedding, retrieval R and plasticity w."""
