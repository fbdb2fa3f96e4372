"""A bench that is not there: scenes, light transport, simulated devices, faults."""
