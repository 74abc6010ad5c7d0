"""Which workers of a Dask cluster may be used: those that have this version of hearthlog."""

import asyncio
from collections.abc import Collection
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from distributed import Client

_SILENT_SECONDS = 20.0  # after which a scheduler that does not answer is as good as gone


class Members:
    """The workers of a cluster, as they come and go."""

    def __init__(self, client: "Client") -> None:
        self._client = client
        self._ours = version("hearthlog")
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._versions: dict[str, str] = {}  # by address, of workers that are there
        self.threads: dict[str, int] = {}  # by address, of workers that may be used
        self.manned = asyncio.Event()  # whether there are any
        self.refused: dict[str, str] = {}  # by address, what other workers have; kept

    async def look(self) -> None:
        """Ask the scheduler which workers there are, and new ones for their version.

        Raise `OSError, TimeoutError` if the scheduler does not answer.
        """
        scheduler: Any = self._client.scheduler
        identity = await asyncio.wait_for(scheduler.identity(n_workers=-1), _SILENT_SECONDS)
        workers = identity["workers"]
        for address in self._versions.keys() - workers.keys():
            del self._versions[address]
        for address in workers.keys() - self._versions.keys() - self._asking.keys():
            # Not waited for: a worker that hangs must not hide that the scheduler does.
            self._asking[address] = asyncio.create_task(self._ask(address))
        self.threads = {
            address: about["nthreads"]
            for address, about in workers.items()
            if self._versions.get(address) == self._ours
        }
        if self.threads:
            self.manned.set()
        else:
            self.manned.clear()

    async def settle(self) -> None:
        """Wait until the workers that were seen have said their version, and look again."""
        if self._asking:
            await asyncio.wait(self._asking.values(), timeout=_SILENT_SECONDS)
        await self.look()

    def any_of(self, addresses: Collection[str]) -> bool:
        """Tell whether one of some workers is still there, and may be used."""
        return not self.threads.keys().isdisjoint(addresses)

    async def _ask(self, address: str) -> None:
        try:
            # A function of the standard library, so that a worker without hearthlog can answer.
            (theirs,) = (
                await self._client.run(version, "hearthlog", workers=[address], on_error="return")
            ).values()
        except (OSError, ValueError):  # it has gone
            return
        finally:
            del self._asking[address]
        if isinstance(theirs, str | PackageNotFoundError):  # else it could not answer this time
            self._versions[address] = theirs if isinstance(theirs, str) else ""
        if isinstance(theirs, PackageNotFoundError):
            self.refused[address] = "no hearthlog"
        elif isinstance(theirs, str) and theirs != self._ours:
            self.refused[address] = f"hearthlog {theirs}"
