"""Studies on ideal signals, for research: what a rule can do, measured against a truth that is an array."""
