"""Records of the finished stages of a study, with inputs and results, in files that survive a kill."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from dvc.atomic_files import write_whole
from dvc.errors import OutputError
from dvc.software import software_key
from dvc.threads import usable_cores
from mrstrain.records.provenance import file_hash, without_folders, without_places
from mrstrain.studies.plan import Stage
from mrstrain.studies.stages import StageResult

_RECORD, _REASON = ".json", ".failed.txt"


class StageRecord(BaseModel):
    """Record of a finished stage."""

    model_config = ConfigDict(
        frozen=True, ser_json_bytes="base64", val_json_bytes="base64", ser_json_inf_nan="constants"
    )

    stage: str
    key: str  # hash of all inputs
    made_utc: str
    seconds: float
    # Hash of the contents of each file that it wrote, by its place in the results folder; of an earlier version, with
    # its size and date.
    files: Mapping[str, str | tuple[int, int, str]]
    result: StageResult
    made_from: dict[str, Any] = {}  # hashes of its input files by name, and its arguments
    checksum: str = ""  # of all the others, as `sealed` computes it

    @property
    def identity(self) -> str:
        """Identity for the stages that depend on it; a repeated stage gets a new identity, even with equal inputs."""
        return hashlib.sha256(f"{self.key} {self.made_utc}".encode()).hexdigest()

    def sealed(self) -> Self:
        """The same with its checksum."""
        content = self.model_copy(update={"checksum": ""}).model_dump_json()
        return self.model_copy(update={"checksum": hashlib.sha256(content.encode()).hexdigest()})


class Ledger:
    """The records in the results folder ``out`` of a study in the folder ``home``."""

    def __init__(self, out: Path, home: Path) -> None:
        self.out, self.home = out, home
        self.folder = out / ".study"
        self._hashes: dict[tuple[str, int, int], str] = {}

    def impersonal(self, text: str, stage: Stage) -> str:
        """A text without folders above the study, files of a stage and the home folder, which may name a person."""
        folders = [place for file in stage.files for place in (file.parent, *([file] if file.is_dir() else []))]
        folders += [Path(os.path.normpath(place)) for place in folders]
        outside = [place for place in folders if not Path(os.path.normpath(place)).is_relative_to(self.home)]
        shortened = {place: ("", "a folder") for place in outside}
        shortened |= {Path.home(): (f"~{os.sep}", "~"), self.home: ("", ".")}
        return without_places(text, shortened)

    def made_from(self, stage: Stage, arguments: Mapping[str, object]) -> dict[str, Any]:
        """Hashes of the input files of a stage, and its arguments without folders, so that a study can be moved."""
        return {"files": self._inputs(stage), "arguments": without_folders(arguments, self.home)}

    def are_unchanged(self, stage: Stage, made_from: Mapping[str, Any]) -> bool:
        """Whether the input files of a stage are as they were when it began."""
        try:
            return bool(self._inputs(stage) == made_from["files"])
        except OSError:  # one is gone
            return False

    def _inputs(self, stage: Stage) -> list[list[Any]]:
        return [[without_folders(str(path), self.home), self._hash(path)] for path in stage.files]

    def key(self, stage: Stage, made_from: Mapping[str, Any], built_on: Mapping[str, StageRecord]) -> str:
        """Hash of the current inputs of a stage; ``built_on`` are the records of the stages that it reads."""
        content = {
            "stage": stage.name, "called": [path.name for path in stage.files], **made_from,
            "built_on": {name: record.identity for name, record in sorted(built_on.items())},
            "software": software_key("mrstrain"),
        }  # fmt: skip
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _hash(self, path: Path) -> str:
        if path.is_dir():
            return file_hash(path)
        state = path.stat()
        version = (str(path), state.st_size, state.st_mtime_ns)
        if version not in self._hashes:
            self._hashes[version] = file_hash(path)
        return self._hashes[version]

    def finished(self, stage: Stage) -> StageRecord | None:
        """The record of a stage if it and all its files are as they were written, whatever its inputs were."""
        try:
            record = StageRecord.model_validate_json(self._file(stage, _RECORD).read_bytes())
        except (OSError, ValidationError):
            return None
        if record.checksum != record.sealed().checksum:
            return None  # damaged: the stage is run again
        own = all(_within(self.out / name, stage.gives) for name in record.files)  # or it was tampered with
        known = {name: of if isinstance(of, str) else of[2] for name, of in record.files.items()}
        return record if own and self._contents(known) == known else None

    def _contents(self, names: Iterable[str]) -> dict[str, str]:
        """Hash of the contents of each of these results that is there, whatever its size and date are."""
        there = [name for name in names if (self.out / name).is_file()]
        with ThreadPoolExecutor(usable_cores()) as pool:  # a gigabyte takes a core 1 to 3 s
            return dict(zip(there, pool.map(lambda name: self._hash(self.out / name), there), strict=True))

    def clear(self, stage: Stage, reason: str = "", *, files: bool) -> None:
        """Mark a stage as not finished, record the reason, and remove its files unless it can resume from them."""
        self._file(stage, _RECORD).unlink(missing_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        if reason:
            write_whole(self._file(stage, _REASON), reason)
        else:
            self._file(stage, _REASON).unlink(missing_ok=True)
        for place in stage.gives if files else ():
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink(missing_ok=True)

    def reason(self, stage: Stage) -> str:
        """The reason why a stage has no result; empty if it was never run."""
        try:
            return self._file(stage, _REASON).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def lock(self, stage: Stage) -> Path:
        """Lock file of a running stage: on a cluster, a worker of a killed run may still be running."""
        return self._file(stage, ".lock")

    def keep(
        self, stage: Stage, key: str, made_from: Mapping[str, Any], result: StageResult, seconds: float
    ) -> StageRecord:
        """Record that a stage is finished; OutputError if a result is not there, as its folder was removed."""
        if lacking := [place for place in stage.gives if not place.exists()]:
            raise OutputError(f"{lacking[0]}: was removed while the study ran. Run it again.")
        made = [p for place in stage.gives for p in (sorted(place.rglob("*")) if place.is_dir() else [place])]
        files = self._contents(p.relative_to(self.out).as_posix() for p in made)
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        record = StageRecord(
            stage=stage.name, key=key, made_utc=now, seconds=round(seconds, 1), files=files, result=result,
            made_from=dict(made_from),
        ).sealed()  # fmt: skip
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(self._file(stage, _RECORD), record.model_dump_json())
        return record

    def _file(self, stage: Stage, ending: str) -> Path:
        return self.folder / f"{stage.name}{ending}"


def _within(path: Path, places: Sequence[Path]) -> bool:
    """Whether a path is one of these places or lies below one of them, however it is written."""
    plain = Path(os.path.normpath(path))
    return any(plain.is_relative_to(os.path.normpath(place)) for place in places)
