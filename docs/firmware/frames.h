// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* Frames of docs/protocol.md: COBS( type | body | crc32 ) 00, little-endian. No I/O and no state of its own. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    TYPE_SAMPLE = 0x01,
    TYPE_STATUS = 0x02,
    TYPE_HELLO = 0x10,
    TYPE_HELLO_REQUEST = 0x11,
    TYPE_PING = 0x12,
    TYPE_PONG = 0x13,
    TYPE_START = 0x14,
    TYPE_STOP = 0x15
};

enum { FLAG_OVER_RANGE = 1, FLAG_DROPPED = 2 };

enum {
    PROTOCOL_VERSION = 1,
    MAX_ENCODED = 512,
    /* COBS adds one byte for each 254 begun; type, CRC and the closing zero come on top of the body. */
    MAX_BODY = 400,
    MAX_FRAME = MAX_BODY + 5 + 3 + 1,
    SAMPLE_BODY = 25,
    STATUS_BODY = 6,
    PONG_BODY = 16
};

/* zlib's CRC-32, for one more byte: start with 0xFFFFFFFF, invert at the end. */
uint32_t crc32_step(uint32_t crc, uint8_t byte);

/* Writes the frame with its closing zero; returns its length. out holds MAX_FRAME bytes, size is at most MAX_BODY. */
size_t frame_encode(uint8_t type, const uint8_t *body, size_t size, uint8_t *out);

/* Takes COBS off in place and checks the CRC of what stood between two zeros. True: buffer[0] is the type and
 * *size the length of type and body. */
bool frame_decode(uint8_t *buffer, size_t *size);

void put_u16(uint8_t *at, uint16_t value);
void put_u32(uint8_t *at, uint32_t value);
void put_u64(uint8_t *at, uint64_t value);

#endif
