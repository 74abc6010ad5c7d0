"""The contract of hearthlog: messages, topics, file names, reading and writing logs."""
