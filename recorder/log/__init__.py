"""The live log: its files, buffering during disk errors, and recovery."""
