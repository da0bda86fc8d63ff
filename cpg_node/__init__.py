"""The central pattern generator: it hears the clock and says the phase, nothing else."""
