"""UDP datagrams of a pcap file as written by tcpdump and Wireshark."""

import logging
import mmap
import struct
from collections.abc import Iterator

logger = logging.getLogger(__name__)

BYTE_ORDERS = {
    b"\xd4\xc3\xb2\xa1": "<",
    b"\x4d\x3c\xb2\xa1": "<",
    b"\xa1\xb2\xc3\xd4": ">",
    b"\xa1\xb2\x3c\x4d": ">",
}
"""Byte order and stamp resolution by the first bytes of the file."""
PCAPNG = b"\x0a\x0d\x0d\x0a"
LINK_HEADER_BYTES = {0: 4, 1: 14, 101: 0, 113: 16, 276: 20}
"""Header size by link type: loopback, Ethernet, raw IP, and both Linux cooked captures."""
ETHERNET, VLAN_TAG = 1, 0x8100
IPV4, UDP = 4, 17
FILE_HEADER_BYTES = 24
UDP_HEADER_BYTES = 8
REASSEMBLY_BYTES = 2**24
"""Most bytes of the file between fragments of one datagram; a sensor sends as many in a second, and the 16 bits of a
datagram's number repeat after 65,536 datagrams."""

Content = bytes | mmap.mmap


def udp_payloads(content: Content, *, num_bytes: int, port: int | None) -> Iterator[list[slice]]:
    """Positions of the payloads of this length, sent to this port (None: any), in order of arrival.

    A payload is one slice, or several if the datagram was fragmented. Incomplete datagrams are skipped.
    Raises ValueError if the file is not a pcap, or has an unknown link type.
    """
    waiting: dict[bytes, dict[int, slice]] = {}  # the fragments of a datagram by their offsets
    wanted_bytes = num_bytes + UDP_HEADER_BYTES
    for start, end in _ip_packets(content):
        header_end = start + 4 * (content[start] & 0xF)
        flags, protocol = struct.unpack_from(">HxB", content, start + 6)
        offset, more = 8 * (flags & 0x1FFF), bool(flags & 0x2000)
        if protocol != UDP or header_end + (0 if offset else UDP_HEADER_BYTES) >= end:
            continue
        if offset == 0:
            sent_to, length = struct.unpack_from(">HH", content, header_end + 2)
            if length != wanted_bytes or port not in (None, sent_to):
                continue
            header_end += UDP_HEADER_BYTES
            if not more:
                if end - header_end == num_bytes:
                    yield [slice(header_end, end)]
                continue
        key = content[start + 12 : start + 20] + content[start + 4 : start + 6]  # source, destination, datagram number
        pieces = waiting.setdefault(key, {})
        if any(start - piece.start > REASSEMBLY_BYTES for piece in pieces.values()):
            pieces.clear()  # of an earlier datagram of the same number, which lost a fragment
        pieces[offset] = slice(header_end, end)
        if 0 in pieces and sum(piece.stop - piece.start for piece in pieces.values()) == num_bytes:
            yield [pieces[place] for place in sorted(pieces)]
            del waiting[key]


def _ip_packets(content: Content) -> Iterator[tuple[int, int]]:
    """First byte and end of every complete IPv4 packet."""
    order = BYTE_ORDERS.get(content[:4])
    if order is None:
        remedy = "; convert it with `editcap -F pcap IN OUT`" if content[:4] == PCAPNG else ""
        raise ValueError(f"this is not the classic pcap format{remedy}")
    if len(content) < FILE_HEADER_BYTES:
        raise ValueError("its header is truncated")
    (link,) = struct.unpack_from(order + "I", content, 20)
    if link not in LINK_HEADER_BYTES:
        raise ValueError(f"unknown link type {link}; known: {', '.join(map(str, LINK_HEADER_BYTES))}")
    record = FILE_HEADER_BYTES
    while record + 16 <= len(content):
        (captured,) = struct.unpack_from(order + "I", content, record + 8)
        start = record + 16 + LINK_HEADER_BYTES[link]
        record += 16 + captured
        if link == ETHERNET and content[start - 2 : start] == VLAN_TAG.to_bytes(2, "big"):
            start += 4
        if start + 20 > min(record, len(content)) or content[start] >> 4 != IPV4:
            continue
        end = start + int.from_bytes(content[start + 2 : start + 4], "big")  # the frame may be padded
        if end <= min(record, len(content)):
            yield start, end
    if record != len(content):
        logger.warning("the recording is cut short: its last packet is incomplete, and what followed is missing")
