"""Model packs drawn at random, valid and broken, read by one process: no crash, no traceback, no file elsewhere."""

import subprocess
import sys
from pathlib import Path

import pytest

COUNT, SEED = 300, 32

READ = """
import encodings.ascii, gzip, os, resource, sys
from pathlib import Path

import numpy as np, scipy.io, scipy.sparse as sp
from packs import Cable, group, manifest, write_arrays, write_cable, write_manifest, write_mesh
from vibench.errors import RequestError, in_a_line
from vibench.packs import meshes, read_model_pack, reader
from vibench.packs.reader import pack_digest

root, count, rng = Path(sys.argv[1]), int(sys.argv[2]), np.random.default_rng(int(sys.argv[3]))
cable = Cable()
A = {name.removeprefix("A/"): array for name, array in group("A", cable.A).items()}
i, j = cable.A.tocoo().coords
TRIPLETS = {"row": i, "col": j, "data": cable.A.data, "shape": np.array(cable.A.shape)}
ODD = [-1, 0, 5, 12, 13, 200, 2**31 - 1, 2**31, 2**40, 2**62, 2**63, 2**64 - 1, 0.5, np.nan, np.inf, -np.inf, 1e308]
TYPES = ["u1", "i1", "u2", "u4", "u8", "i8", ">i4", "f2", "f4", "f8", ">f8", "c16", "?", "S3", "O"]
TEXTS = ["", ":", "..", "../A.npz", "/etc/passwd", "A.npz:", "A.npz:no", "A{}.npz", "link.npz", "link/A.npz",
         "pack.toml", "A.h5", "A.h5:/A", "A.mtx", "A.mtx.gz", "e",
         "pi", "max", "\\u00b5", "\\u03bc", "x\\u00b2", "load", "-load",
         "load.real", "1/0", "1e999", "__import__('os')", "exp(1000)", "(" * 300, "\\0", "x" * 3000]


MESHES = ["xdmf", "inp", "ele", "e", "xml", "med", "VTU", *"msh vtu vtk mesh ply stl off obj".split()]


def read_mesh(path, limit, seconds):
    '''In this process, whose files are watched; otherwise in one of its own.'''
    form = meshes.format_of(path)
    try:
        return meshes.triangles_of(form, str(path)).values()
    except (Exception, SystemExit) as error:
        raise RequestError(in_a_line(error)) from None


reader.read_mesh = read_mesh


def pick(values):
    return values[rng.integers(len(values))]


def broken(array):
    way, array = rng.integers(6), np.array(array)
    with np.errstate(all="ignore"):
        if way == 0:
            return array.astype(pick(TYPES))
        if way == 1 and array.size:
            typed = array.astype(pick(TYPES[:11]))
            flat, odd = typed.ravel(), pick(ODD)
            try:
                flat[rng.integers(flat.size)] = odd
            except (ValueError, OverflowError):
                pass  # no value of this type
            return typed
        if way == 2:
            return array.ravel()[: rng.integers(array.size + 1)]
        if way == 3:
            return np.concatenate([array.ravel()] * 2)
        if way == 4:
            return array[None]
    return np.array(pick(ODD))


def mutated(content):
    '''Change one value of the manifest, wherever it is.'''
    while isinstance(content, (dict, list)):
        place, key = content, pick(list(content) if isinstance(content, dict) else range(len(content)))
        content = place[key]
        if rng.random() < 0.15:
            break
    way = rng.integers(5)
    place[key] = (pick(TEXTS) if way < 2 else pick(ODD[:8] + ODD[12:]) if way == 2
                  else {"grid": [int(pick(ODD[:12])) % 2**63, 3]} if way == 3 else {"each": pick(TEXTS)})


def write(folder):
    '''A pack with up to two faults in its files, and up to two in its manifest.'''
    folder.mkdir()
    (folder / "link.npz").symlink_to("../first/A.npz")
    (folder / "link").symlink_to("../first")
    content, how = manifest(), rng.integers(6)
    write_arrays(folder, cable)
    parts = dict(pick([A, A, TRIPLETS]))
    for _ in range(rng.integers(3)):
        key = pick(list(parts))
        parts[key] = broken(parts[key if rng.random() < 0.8 else pick(list(parts))])
    if rng.random() < 0.3:
        parts["format"] = np.array(pick(["csr", "csc", "bsr", ""]), "S3")
    if how < 3:
        np.savez(folder / "A.npz", **parts)
    elif how == 3:
        import h5py
        with h5py.File(folder / "A.h5", "w") as file:
            for name, array in parts.items():
                if array.dtype != object:
                    file[f"A/{name}"] = array
        content["operators"]["A"] = "A.h5:A"
    else:
        text = f"%%MatrixMarket matrix {pick(['coordinate', 'array'])} real {pick(['general', 'symmetric'])}\\n"
        text += " ".join(str(pick([12, 12, 12, *ODD])) for _ in range(3)) + "\\n"
        text += "".join(f"{a + 1} {b + 1} {v}\\n" for a, b, v in zip(i, j, cable.A.data))
        name = pick(["A.mtx", "A.mtx.gz"])
        (folder / name).write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
        content["operators"]["A"] = name
    if rng.random() < 0.15:
        file = folder / pick(["A.npz", "spaces.npz", "vectors.npz"])
        damaged = bytearray(file.read_bytes())
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        file.write_bytes(damaged[: len(damaged) if rng.random() < 0.5 else rng.integers(len(damaged))])
    if rng.random() < 0.5:
        name = f"mesh.{pick(MESHES)}"
        content["mesh"] = write_mesh(folder, name, str(first / "A.npz"))
        if rng.random() < 0.5:
            damaged = bytearray((folder / name).read_bytes())
            for _ in range(rng.integers(4)):
                damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
            (folder / name).write_bytes(damaged[: len(damaged) if rng.random() < 0.5 else rng.integers(len(damaged))])
    if rng.random() < 0.1:
        content["operators"]["A"] = pick(["link.npz", "link/A.npz", "../first/A.npz", str(first / "A.npz")])
    for _ in range(rng.integers(3)):
        mutated(content)
    write_manifest(folder, content)


def read(folder):
    try:
        pack_digest(folder)
        pack = read_model_pack(folder)
    except RequestError as error:
        assert "\\n" not in str(error), error
        return False
    for member in pack.members.values():
        for array in member.arrays:
            if sp.issparse(array):
                array.check_format(full_check=True)
    return True


first = write_cable(root / "first")  # imports what is imported late
scipy.io.mmwrite(first / "A.mtx", cable.A)
write_manifest(first, {**manifest(), "operators": {**manifest()["operators"], "A": "A.mtx"}})
for name in ("VTU", "msh", "vtk", "mesh", "ply", "stl", "off", "obj"):
    write_manifest(first, {**manifest(), "mesh": write_mesh(first, f"mesh.{name}", "")})
    assert read(first), name
write_manifest(first, {**manifest(), "operators": {**manifest()["operators"], "A": "A.mtx"}})
assert read(first)
with np.errstate(all="ignore"):
    for k in range(count):
        write(root / str(k))
space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (space + 2**30, space + 2**30))
opened, inside, spent = set(), False, resource.getrusage(resource.RUSAGE_SELF).ru_utime


def watch(event, given):
    if inside and event in ("open", "os.listdir", "os.scandir", "subprocess.Popen", "os.system", "socket.connect"):
        opened.add((event, str(given[0]), k))


sys.addaudithook(watch)
accepted = 0
for k in range(count):
    print(k, end=" ", flush=True)
    inside = True
    accepted += read(root / str(k))
    inside = False
limits = (os.path.realpath("/proc/self/cgroup"), "/sys/fs/cgroup")
print()
print(accepted, sorted(
    (event, path) for event, path, k in opened
    if event != "open" or not os.path.realpath(path).startswith((os.path.realpath(root / str(k)) + "/", *limits))
))
print(resource.getrusage(resource.RUSAGE_SELF).ru_utime - spent, file=sys.stderr)
"""
"""Writes the packs first; the limit of memory and the hook are for reading."""


@pytest.mark.long
def test_drawn_packs_are_read_or_refused_in_a_line(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    pytest.importorskip("meshio")
    command = [sys.executable, "-c", READ, str(tmp_path), str(COUNT), str(SEED)]
    helpers = str(Path(__file__).parents[1] / "helpers")
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=300,
        env={"PYTHONPATH": helpers, "PATH": "/usr/bin"},
    )  # fmt: skip
    assert done.returncode == 0, (done.returncode, done.stdout[-200:], done.stderr[-3000:])
    accepted, _, elsewhere = done.stdout.splitlines()[-1].partition(" ")
    assert elsewhere == "[]"
    assert COUNT // 20 < int(accepted) < COUNT // 2
