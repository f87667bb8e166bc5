"""What a file's name promises: a FITS under the name of a picture is refused before it is written."""

from __future__ import annotations

from pathlib import Path

from hilstar.errors import InputError

# The first of each is the one to write.
FITS = (".fits", ".fit", ".fts")
PNG = (".png",)
PNG_OR_TIFF = (".png", ".tif", ".tiff")
CSV = (".csv",)
TOML = (".toml",)
MCAP = (".mcap",)
KNOWN = {
    *(
        ".fits",
        ".fit",
        ".fts",
        ".png",
        ".tif",
        ".tiff",
        ".jpg",
        ".jpeg",
        ".gif",
        ".bmp",
        ".webp",
        ".svg",
        ".pdf",
        ".ps",
        ".eps",
    ),
    *(".csv", ".tsv", ".json", ".jsonl", ".toml", ".yaml", ".yml", ".xml", ".aem", ".kvn", ".mcap", ".html", ".md", ".txt"),
    *(".npy", ".npz", ".h5", ".hdf5", ".mat", ".zip", ".tar", ".parquet", ".xlsx", ".py"),
}


def check_ending(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    """Refuse (InputError) a name that ends as another kind of file does; a name that says nothing is taken.

    `endings` are those of the kind that is written, and .gz after those of FITS.
    """
    if path is None:
        return
    ending = path.suffix.lower()
    if endings is FITS and ending == ".gz":
        ending = path.with_suffix("").suffix.lower()
    if ending not in endings and (ending in KNOWN or path.suffix.lower() == ".gz"):
        # A name as it may be on this file system, so that it can be copied from the line.
        better = path.with_suffix("").name or "OUT"
        raise InputError(f"{option} {path}: {_article(endings)} is written there; write {better}{endings[0]}")


def check_directory(option: str, path: Path | None) -> None:
    """Refuse (InputError) the name of a file where a directory is made."""
    if path is not None and path.suffix.lower() in KNOWN and not path.is_dir():
        raise InputError(
            f"{option} {path}: several files are written, into a directory; write the name of one, such as {path.stem}"
        )


def _article(endings: tuple[str, ...]) -> str:
    names = {FITS: "a FITS file", PNG: "a PNG picture", PNG_OR_TIFF: "a PNG or TIFF picture", CSV: "a CSV table"}
    return (names | {TOML: "a TOML file", MCAP: "an MCAP file"})[endings]
