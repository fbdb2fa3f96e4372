"""What a scan is: patterns, mathematics, the two rounds, the recording, the results."""
