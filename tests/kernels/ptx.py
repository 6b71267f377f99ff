"""Faults of Triton's compiler that show in what it made: see hazards and overwritten_tiles."""

import re

WAIT = "wgmma.wait_group"
BARRIERS = ("bar.sync", "barrier.sync", "barrier.cta.sync")
WRITES = ("st.shared", "stmatrix", "cp.async.ca", "cp.async.cg", "cp.async.bulk", "atom.shared", "red.shared")


def hazards(ptx):
    """Writes to shared memory that one group of four warps may make while another's product still reads it.

    After a wait for products each group goes on by itself: Triton's wait does not hold the others (triton issue 11047),
    so that between a wait and the next write to shared memory there must be a barrier. Kernels of one group have none.
    """
    if int(re.findall(r"\.reqntid (\d+)", ptx)[0]) <= 128:
        return []
    lines = [line.strip() for line in ptx.split("\n")]
    place = {line.split(":")[0]: i for i, line in enumerate(lines) if re.match(r"\$\w+:", line)}
    found = []
    for start in (i for i, line in enumerate(lines) if line.startswith(WAIT)):
        ahead, seen = [start + 1], set()
        while ahead:
            i = ahead.pop()
            while i < len(lines) and i not in seen:
                seen.add(i)
                line = lines[i]
                operation = line.split(maxsplit=1)[-1] if line.startswith("@") else line
                if operation.startswith(BARRIERS) or operation.startswith("ret"):
                    break
                if operation.startswith(WRITES):
                    found.append(f"line {start}: {lines[start]} … line {i}: {line}")
                    break
                if operation.startswith("bra"):
                    ahead.append(place[operation.rstrip(";").split()[-1]])
                    if not line.startswith("@"):
                        break
                i += 1
    return found


def overwritten_tiles(ttgir):
    """How many tiles are copied to shared memory ahead, and how many products may be under way during the next copy.

    Of a tile that is read twice Triton keeps one buffer too few for a product under way (3.6 and 3.9): the tile after
    the next is copied over the one that is being multiplied. It must be none where tiles are copied ahead.
    """
    ahead = len(re.findall(r"local_alloc : \(\) -> !ttg.memdesc<[2-9]x", ttgir))
    return ahead, max(map(int, re.findall(r"warp_group_dot_wait.*pendings = (\d+)", ttgir)))
