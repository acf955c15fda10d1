"""Folders of a house's captures and products: read from the environment when deployments are made."""

import os
from pathlib import Path

PLACES = {
    "inbox": ("NLIGHTS_INBOX", "/srv/nlights/inbox"),
    "products": ("NLIGHTS_PRODUCTS", "/srv/nlights/products"),
    "flat": ("NLIGHTS_FLAT", "/srv/nlights/flat"),
    "until": ("NLIGHTS_UNTIL", "06:00"),
    "evening": ("NLIGHTS_EVENING", "0 20 * * *"),
    "weekly": ("NLIGHTS_WEEKLY", "0 7 * * 1"),
    "timezone": ("NLIGHTS_TIMEZONE", "Europe/Rome"),
}
"""What ``deploy/prefect.yaml`` asks for: the environment's variable, and what is taken without it."""


def places() -> dict[str, str]:
    """Say where things are and when work starts; a build step of ``deploy/prefect.yaml``.

    Prefect's own templates know no default; this step does.

    Returns
    -------
    dict
        By the names of `PLACES`.  Folders must be absolute: a worker starts runs anywhere.

    Raises
    ------
    ValueError
        When a folder is not absolute.

    Examples
    --------
    >>> import os
    >>> os.environ["NLIGHTS_INBOX"] = "/data/inbox"
    >>> places()["inbox"]
    '/data/inbox'
    """
    found = {name: os.environ.get(variable) or default for name, (variable, default) in PLACES.items()}
    for name in ("inbox", "products", "flat"):
        if not Path(found[name]).is_absolute():
            raise ValueError(
                f"{PLACES[name][0]}: '{found[name]}' is not absolute; write it from the root, as {PLACES[name][1]}"
            )
    return found
