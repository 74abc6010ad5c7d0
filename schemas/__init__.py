"""Log format of hearthlog: messages, topics, file names, reading and writing."""
