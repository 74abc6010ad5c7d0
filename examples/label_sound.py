"""Label a sound file, as a recorder would: python label_sound.py MODEL.safetensors SOUND.wav."""

import sys

import soundfile

import hearthlog


def main(model: str, path: str) -> None:
    """Print what is heard from when to when, and how sure the model is."""
    sound, rate = soundfile.read(path, dtype="int16")
    labels = hearthlog.classify(hearthlog.load_model(model), sound, rate)
    confidence = labels.probabilities.max(axis=1)
    spans = labels.segments
    for start, end, label in zip(spans.starts, spans.ends, spans.labels, strict=True):
        mean = confidence[(labels.times >= start) & (labels.times < end)].mean()
        print(f"{start / 1e9:8.2f} s {end / 1e9:8.2f} s  {label:20} {mean:.2f}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except hearthlog.HearthlogError as error:
        sys.exit(str(error))
