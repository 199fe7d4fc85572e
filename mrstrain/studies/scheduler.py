"""A Dask scheduler at an address: connected to, or refused where it is open to a network or its workers are unfit."""

import multiprocessing
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from distributed import Client

from dvc.errors import InputError
from dvc.software import software_key

_CONNECT_S, _WORKERS_S = 10.0, 60.0


@contextmanager
def at_address(scheduler: str, places: Sequence[Path]) -> Iterator[Client]:
    """A client of the scheduler at an address (tls://node1:8786), whose workers have access to ``places``.

    InputError if it is on a network without TLS, cannot be reached, or has no workers or unsuitable ones.
    """
    _refuse_unencrypted(scheduler)
    try:
        client = _ClosedIfRefused(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:  # the last without certificates
        raise InputError(
            f"No Dask scheduler answers at {scheduler} ({error}). Start one as described in docs/cluster.md."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as none:
            raise InputError(
                f"The scheduler at {scheduler} has no workers after {_WORKERS_S:.0f} s. Start workers as described "
                "in docs/cluster.md."
            ) from none
        _refuse_unfit(client, scheduler, places)
        yield client


class _ClosedIfRefused(Client):
    """A client that is closed where it cannot connect, such as without a certificate.

    Dask leaves that to the garbage collector. Where this happens while the thread of another client or cluster starts,
    both wait for one lock, and that start fails after 10 s.
    """

    def __init__(self, address: str, timeout: float) -> None:
        try:
            super().__init__(address, timeout=timeout)
        except BaseException:
            self.close()
            raise


def _refuse_unencrypted(address: str) -> None:
    """InputError for a scheduler on a network without TLS: whoever reaches it runs code as its user."""
    scheme, _, place = address.rpartition("://")
    try:
        host = urlsplit(f"//{place}").hostname or ""
        own = host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # a name, or no address
        own = False
    if not own and scheme != "tls":
        raise InputError(
            f"{address}: whoever reaches a Dask scheduler without TLS can run code as its user. Start scheduler and "
            "workers with TLS, as described in docs/cluster.md, and give its address as tls://HOST:PORT."
        )


def _refuse_unfit(client: Client, address: str, places: Sequence[Path]) -> None:
    tokens = [out / f".seen-{uuid.uuid4().hex}" for out in places]
    for token in tokens:
        token.touch()
    try:
        answers = client.run(_about, [str(token) for token in tokens])
    except ImportError as error:
        raise InputError(
            f"mrstrain is not installed for the workers at {address} ({error}). Start them in its environment."
        ) from error
    finally:
        for token in tokens:
            token.unlink(missing_ok=True)
    here = software_key("mrstrain").split(", ")
    for worker, (key, daemon, seen) in answers.items():
        threads, there = client.nthreads().get(worker, 1), key.split(", ")
        theirs, ours = (", ".join(p for p in one if p not in rest) for one, rest in ((there, here), (here, there)))
        for unfit, why in (
            (there != here, f"has {theirs}, but this machine has {ours}. Start workers in the same environment."),
            (not seen, f"has no access to {places[0]}. A study must be on a file system that all machines share."),
            (threads > 1, f"runs {threads} stages at the same time; each needs its own process. Use --nthreads 1."),
            (daemon, "may not start processes. Set DASK_DISTRIBUTED__WORKER__DAEMON=False in its environment."),
        ):
            if unfit:
                raise InputError(f"The worker {worker} {why}")


def _about(tokens: Sequence[str]) -> tuple[str, bool, bool]:
    seen = all(Path(token).exists() for token in tokens)
    return software_key("mrstrain"), multiprocessing.current_process().daemon, seen
