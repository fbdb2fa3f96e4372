"""What makes a bench measurable: boards, solver, photometry, latency, acceptance, the wizard. Knows the scanner."""
