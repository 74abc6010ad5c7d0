"""Which features a log has: entries of its metadata record `hearthlog`."""

from collections.abc import Mapping

FEATURE_SET = "feature_set"
VERSION = "feature_set_version"
DIGEST = "feature_set_sha256"
DISTRIBUTION = "feature_set_distribution"
_DETAILS = (VERSION, DIGEST, DISTRIBUTION)


def feature_entries(name: str, version: int, digest: str, distribution: str) -> dict[str, str]:
    """Return what the record says of a feature set.

    Parameters
    ----------
    digest : str
        SHA-256 of the network that computes it; empty for none.
    distribution : str
        Which brings it, and its version; empty for hearthlog itself.
    """
    entries = {FEATURE_SET: name, VERSION: str(version)}
    return entries | {k: v for k, v in ((DIGEST, digest), (DISTRIBUTION, distribution)) if v}


def other_features(
    first: Mapping[str, str], other: Mapping[str, str], microphone: str
) -> dict[str, str]:
    """Return what the record says of the features of another microphone than the first."""
    return {
        f"/{microphone}/{key}": other.get(key, "")
        for key in _DETAILS
        if other.get(key, "") != first.get(key, "")
    }


def features_of_microphone(record: Mapping[str, str], microphone: str) -> dict[str, str]:
    """Return a record with what it says of the features of one microphone."""
    own = {key: record.get(f"/{microphone}/{key}", record.get(key, "")) for key in _DETAILS}
    others = {key: text for key, text in record.items() if key not in own}
    return others | {key: text for key, text in own.items() if text}
