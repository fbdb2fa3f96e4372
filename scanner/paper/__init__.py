"""The experiments of Optics Express 27(20) 28293 (2019), made again into one report: what `scan paper` does."""
