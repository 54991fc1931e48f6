/* Frames of the serial link: COBS, CRC-32, and an authentication tag.
 *
 *   encoded = COBS(bytes) 0x00
 *   bytes   = type (1), version (1), zero (2), sequence (4), payload, tag (8), crc (4)      little-endian
 *   tag     = SipHash-2-4 over everything before it; crc = CRC-32 over everything before it
 *
 * The types of the two directions differ, so that a frame cannot be sent back to its sender.
 */
#ifndef FIRMWARE_FRAME_H
#define FIRMWARE_FRAME_H

#include <stdint.h>

#include "protocol/siphash.h"

#define FRAME_VERSION 1u
#define FRAME_HEADER 8u
#define FRAME_TRAILER 12u
#define FRAME_MAX_PAYLOAD 1000u
#define FRAME_MAX_BYTES (FRAME_HEADER + FRAME_MAX_PAYLOAD + FRAME_TRAILER)
#define FRAME_MAX_ENCODED (FRAME_MAX_BYTES + FRAME_MAX_BYTES / 254u + 2u)

/* why a frame was refused */
typedef enum { FRAME_OK, FRAME_TORN, FRAME_TOO_LONG, FRAME_BAD_CRC, FRAME_BAD_VERSION, FRAME_BAD_TAG } frame_error;

/* collects the bytes of one frame until its delimiter, and decodes COBS in place */
typedef struct {
  uint8_t bytes[FRAME_MAX_BYTES];
  uint32_t size; /* decoded bytes so far */
  uint8_t left;  /* bytes left in the current COBS block */
  uint8_t block; /* code of the current COBS block, 0: at the beginning of a frame */
  uint8_t overflow;
} frame_reader;

typedef struct {
  uint8_t type;
  uint32_t sequence, payload_size;
  const uint8_t *payload;
} frame;

void frame_reader_clear(frame_reader *reader);

/* adds one received byte. Returns 1 at the end of a frame, whose bytes are in the reader until the next call of
 * frame_reader_clear */
int frame_reader_add(frame_reader *reader, uint8_t byte);

/* checks a completed frame except for its tag */
frame_error frame_parse(const frame_reader *reader, frame *to);

/* 1 if the tag of a parsed frame is that of the key */
int frame_tag_valid(const frame *f, const siphash_key *key);

/* encodes a frame in `encoded` (FRAME_MAX_ENCODED bytes). Returns the number of bytes, 0 if the payload is too long */
uint32_t frame_encode(uint8_t type, uint32_t sequence, const uint8_t *payload, uint32_t size, const siphash_key *key,
                      uint8_t *encoded);

uint32_t frame_crc32(const uint8_t *data, uint32_t size);

#endif
