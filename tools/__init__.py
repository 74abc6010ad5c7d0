"""The command line, the benchmarks and the simulated home."""
