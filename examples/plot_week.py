"""Draw the days of some logs, a line each: python plot_week.py LOGS WEEK.png."""

import sys

import numpy as np

import hearthlog

try:
    import matplotlib.pyplot as plt
except ModuleNotFoundError as error:
    sys.exit(f"{error}; try, in the clone of hearthlog: pip install '.[headless]'")

DAY = 86_400 * 1_000_000_000  # nanoseconds, of UTC


def main(path: str, picture: str) -> None:
    """Draw what was heard at which time of day."""
    spans = hearthlog.open_logs(path).segments()
    days = spans.starts // DAY
    figure, axes = plt.subplots(figsize=(10, 4), layout="constrained")
    for label in np.unique(spans.labels[spans.labels != "silence"]):
        same = spans.labels == label
        hours = (spans.starts[same] % DAY) / DAY * 24
        lengths = (spans.ends - spans.starts)[same] / DAY * 24
        axes.barh(days[same] - days.min(), lengths, left=hours, label=label)
    axes.set(xlim=(0, 24), xlabel="hour of day (UTC)", ylabel="day")
    figure.legend(loc="outside right upper")
    figure.savefig(picture)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except hearthlog.HearthlogError as error:
        sys.exit(str(error))
