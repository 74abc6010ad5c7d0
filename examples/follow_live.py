"""Print what a recorder hears, as it hears it, until Ctrl-C: python follow_live.py LOGS [MIC]."""

import sys
from contextlib import suppress
from datetime import UTC, datetime

import hearthlog


def main(path: str, microphone: str = "mic") -> None:
    """Print a line for each change of the label."""
    last = ""
    for batch in hearthlog.follow(path, [f"/{microphone}/label"]):
        for labels in batch:
            for time, label in zip(labels["header.stamp"], labels["label"], strict=True):
                if label != last:
                    print(f"{datetime.fromtimestamp(time / 1e9, UTC):%T.%f} {label}", flush=True)
                last = label


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    try:
        with suppress(KeyboardInterrupt):
            main(*sys.argv[1:])
    except hearthlog.HearthlogError as error:
        sys.exit(str(error))
