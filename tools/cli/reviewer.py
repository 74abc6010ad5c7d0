"""Who makes marks: the name that `--reviewer` gives, or the login name."""

import getpass

from hearthlog.tools.cli.text import wrong_use


def reviewer_name(option: str | None) -> str:
    """Name the reviewer; empty if nobody is named, and the login has no name."""
    from hearthlog.analyzer.marks.marks import PERSON_NAME

    if option is not None:
        name = option.strip()
        if not name or not PERSON_NAME.fullmatch(name):
            wrong_use(f"--reviewer {option[:64]!r}: a name has 1 to 200 characters, in one line")
        return name
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        return ""
    return name if PERSON_NAME.fullmatch(name) else ""
