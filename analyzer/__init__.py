"""Everything that reads logs and labelled audio: training, summaries, pictures."""
