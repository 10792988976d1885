"""A minimal OLE2 compound file (MS-CFB, version 3): streams by path, such as 'ImageInfo/Angles', for readers of Zeiss' files."""

import struct

SECTOR, SMALL, CUTOFF = 512, 64, 4096
FREE, END, FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD
NONE = 0xFFFFFFFF


def write_ole2(path, streams):
    """Writes `streams`, bytes by path, one level of folders deep or none."""
    sectors, chain = [], []  # what is in each sector, and the next one of its stream

    def add(data):
        """The first sector of data."""
        if not data:
            return END
        first, count = len(sectors), -(-len(data) // SECTOR)
        for k in range(count):
            sectors.append(data[k * SECTOR : (k + 1) * SECTOR].ljust(SECTOR, b'\0'))
            chain.append(first + k + 1 if k + 1 < count else END)
        return first

    small, small_chain = b'', []

    def place(data):
        nonlocal small
        if len(data) >= CUTOFF:
            return add(data)
        first, count = len(small) // SMALL, -(-len(data) // SMALL)
        small += data.ljust(count * SMALL, b'\0')
        small_chain.extend([*range(first + 1, first + count), END] if count else [])
        return first if count else END

    # Entries: root, then folders, then streams; the members of a folder are a list by their right siblings.
    folders = sorted({name.split('/')[0] for name in streams if '/' in name})
    members = {None: [*folders, *(name for name in streams if '/' not in name)]}
    members |= {folder: [name for name in streams if name.startswith(folder + '/')] for folder in folders}
    names = [None, *folders, *streams]
    index = {name: k for k, name in enumerate(names)}
    right = {a: index[b] for group in members.values() for a, b in zip(group, group[1:])}
    first_child = {owner: index[group[0]] for owner, group in members.items() if group}
    entries = b''
    placed = {name: (place(data), len(data)) for name, data in streams.items()}
    root = add(small), len(small)
    for name in names:
        kind = 5 if name is None else 1 if name in folders else 2
        text = ('Root Entry' if name is None else name.split('/')[-1]).encode('utf-16-le') + b'\0\0'
        start, size = root if name is None else placed.get(name, (0, 0))
        entries += struct.pack(
            '<64sHBBIII16sIQQIQ', text, len(text), kind, 1, NONE, right.get(name, NONE), first_child.get(name, NONE),
            bytes(16), 0, 0, 0, start, size,
        )  # fmt: skip
    directory = add(entries + b'\0' * (-len(entries) % SECTOR))
    table = struct.pack(f'<{len(small_chain)}I', *small_chain)
    mini = add(table.ljust(-(-len(table) // SECTOR) * SECTOR, b'\xff')) if table else END
    minis = -(-len(table) // SECTOR)
    fats = 1
    while fats * SECTOR // 4 < len(sectors) + fats:
        fats += 1
    starts = list(range(len(sectors), len(sectors) + fats))
    fat = [*chain, *[FAT] * fats]
    fat += [FREE] * (fats * SECTOR // 4 - len(fat))
    header = struct.pack(
        '<8s16sHHHHH6sIIIIIIIIII', b'\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1', bytes(16), 0x3E, 3, 0xFFFE, 9, 6, bytes(6), 0, fats,
        directory, 0, CUTOFF, mini, minis, END, 0, starts[0],
    )  # fmt: skip
    header += struct.pack('<108I', *starts[1:], *[FREE] * (108 - len(starts[1:])))
    path.write_bytes(header + b''.join(sectors) + struct.pack(f'<{len(fat)}I', *fat))
