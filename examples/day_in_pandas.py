"""Minutes of each sound in each hour of a day: python day_in_pandas.py LOGS 2026-03-01 [ZONE]."""

import sys

import hearthlog

try:
    import pandas as pd
except ModuleNotFoundError as error:
    sys.exit(f"{error}; try, in the clone of hearthlog: pip install '.[headless]'")


def main(path: str, day: str, zone: str = "UTC") -> None:
    """Print a table of the hours of a day, and how loud they were."""
    start = pd.Timestamp(day, tz=zone)
    end = start + pd.DateOffset(days=1)
    logs = hearthlog.open_logs(path, start.value, end.value)
    (microphone, *_) = logs.microphones
    labels = logs.pandas(f"/{microphone}/label").tz_convert(zone)
    frames = pd.crosstab(labels.index.hour, labels["label"], rownames=["hour"])
    print((frames * 0.05 / 60).round(1).to_string())
    energy = logs.pandas(f"/{microphone}/features").tz_convert(zone)["values.energy"]
    print(energy.groupby(energy.index.hour).describe().to_string(float_format="%.2e"))


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except hearthlog.HearthlogError as error:
        sys.exit(str(error))
