"""Faults of Triton's compiler that show in what it made: see hazards and overwritten_tiles."""

import operator
import re
from functools import cache

WAIT = "wgmma.wait_group"
BARRIERS = ("bar.sync", "barrier.sync", "barrier.cta.sync")
WRITES = ("st.shared", "stmatrix", "cp.async.ca", "cp.async.cg", "cp.async.bulk", "atom.shared", "red.shared")
WIDEST = 16  # bytes that a thread writes at its address, unless in bulk
ATOM = 1024  # bytes, and their alignment, within which an operand of a product is swizzled
COMPUTED = {
    "mov.": lambda x: x,
    "cvt.u64.u32": lambda x: x,
    "add.s32": operator.add,
    "add.s64": operator.add,
    "mul.lo": operator.mul,
    "mad.lo": lambda x, y, z: x * y + z,
    "and.": operator.and_,
    "or.": operator.or_,
    "xor.": operator.xor,
    "shl.": operator.lshift,
    "shr.u": operator.rshift,
    "bfe.u": lambda x, first, bits: (x >> first) % 2**bits,
    "bfe.s": lambda x, first, bits: (x >> first) % 2 ** (bits - 1) - ((x >> first) & 1 << (bits - 1)),
}


def evaluation(lines):
    """Returns a function for a register's value in a thread, with shared memory at address 0. The function returns None
    if the value varies, or depends on more than the thread's number and the registers in COMPUTED."""
    definitions = {}
    for line in lines:
        if match := re.match(r"(?:@\S+\s+)?[a-z][\w.:]*\s+(?:\{([^}]*)\}|(%\w+))", line):
            for register in re.findall(r"%\w+", match[1] or match[2]):
                definitions.setdefault(register, []).append(line)

    @cache
    def value(name, thread):
        if not name.startswith("%") or name == "%tid.x":
            return {"%tid.x": thread, "global_smem": 0}.get(name) if name.strip("-0123456789") else int(name)
        (line, *others) = definitions.get(name, [""])
        sources = [x.strip() for x in line.rstrip(";").split(",")[1:]]
        if line.startswith("shfl.sync.idx") and sources[1:] == ["0", "31", "-1"]:
            return value(sources[0], thread // 32 * 32)
        compute = next((COMPUTED[x] for x in COMPUTED if line.startswith(x)), None)
        if others or compute is None:
            return None
        sources = [value(x, thread) for x in sources]
        return None if None in sources else compute(*sources) % 2 ** (64 if name.startswith("%rd") else 32)

    return value


def places_read(lines, value, threads):
    """From where to where products read shared memory, at most; None where it is not known."""
    for line in lines:
        if columns := re.match(r"wgmma\.mma_async\S*\.m64n(\d+)k", line):
            for descriptor in (value(x, warp) for x in re.findall(r"%rd\d+", line) for warp in range(0, threads, 32)):
                if descriptor is None:
                    yield None
                    continue
                first, *apart = (((descriptor >> at) & 0x3FFF) << 4 for at in (0, 16, 32))
                first -= first % ATOM
                yield first, first + (max(64, int(columns[1])) // 8 - 1) * sum(apart) + ATOM


def hazards(ptx):
    """Returns writes to shared memory by a group of four warps while the product of another group may still read it.
    After a wait for products each group continues independently: Triton's wait does not stop the others (triton issue
    11047, fixed in 3.9). A barrier is therefore needed between a wait and the next write to the operands of a product.
    Kernels of one group have no such writes. A write or an operand with an unknown address counts as one."""
    threads = int(re.findall(r"\.reqntid (\d+)", ptx)[0])
    if threads <= 128:
        return []
    lines = [line.strip() for line in ptx.split("\n")]
    value = evaluation(lines)
    read = set(places_read(lines, value, threads))

    def overwrites(operation):
        register, offset = re.findall(r"\[\s*(%\w+)\s*(?:\+\s*(-?\d+))?\s*\]", operation)[0]
        places = [value(register, thread) for thread in range(threads)]
        if "bulk" in operation or None in places or None in read or not read:
            return True
        first, end = min(places) + int(offset or 0), max(places) + int(offset or 0) + WIDEST
        return any(first < last and start < end for start, last in read)

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
                if operation.startswith(WRITES) and overwrites(operation):
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
