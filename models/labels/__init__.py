"""From probabilities to labels: smoothing, segments."""
