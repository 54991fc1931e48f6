"""Words of an instruction that look like a clause and need none of its rules, replaced by letters before the search."""
