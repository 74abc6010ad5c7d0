"""The frame: the step in which sound becomes features and labels, in every log.

What is computed from a frame is a feature set's own concern; how long it is, and of how many
samples, is not, for everything that reads logs counts time in frames.
"""

from hearthlog.schemas.times import NANOSECONDS

SAMPLE_RATE = 16_000  # Hz, one channel
FRAME_SAMPLES = 800
FRAME_SECONDS = FRAME_SAMPLES / SAMPLE_RATE
FRAME_NANOSECONDS = NANOSECONDS * FRAME_SAMPLES // SAMPLE_RATE
