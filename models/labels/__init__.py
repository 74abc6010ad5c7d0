"""From probabilities to labels: smoothing and segments."""
