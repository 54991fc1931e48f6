/* Frames of the serial link; see frame.h. */
#include "protocol/frame.h"

#include "protocol/bytes.h"

uint32_t frame_crc32(const uint8_t *data, uint32_t size) {
  uint32_t crc = 0xFFFFFFFFu;
  for (uint32_t i = 0; i < size; ++i) {
    crc ^= data[i];
    for (int bit = 0; bit < 8; ++bit) { crc = (crc >> 1) ^ (0xEDB88320u & (0u - (crc & 1u))); }
  }
  return ~crc;
}

void frame_reader_clear(frame_reader *reader) {
  reader->size = 0;
  reader->left = reader->block = reader->overflow = 0;
}

static void append(frame_reader *reader, uint8_t byte) {
  if (reader->size < FRAME_MAX_BYTES) {
    reader->bytes[reader->size++] = byte;
  } else {
    reader->overflow = 1;
  }
}

int frame_reader_add(frame_reader *reader, uint8_t byte) {
  if (byte == 0u) { return reader->block != 0u || reader->size != 0u || reader->overflow; }
  if (reader->left == 0u) { /* `byte` is the code of the next block */
    if (reader->block != 0u && reader->block != 0xFFu) { append(reader, 0u); }
    reader->block = byte;
    reader->left = (uint8_t)(byte - 1u);
  } else {
    append(reader, byte);
    --reader->left;
  }
  return 0;
}

frame_error frame_parse(const frame_reader *reader, frame *to) {
  if (reader->overflow) { return FRAME_TOO_LONG; }
  if (reader->left != 0u || reader->size < FRAME_HEADER + FRAME_TRAILER) { return FRAME_TORN; }
  const uint8_t *b = reader->bytes;
  if (frame_crc32(b, reader->size - 4u) != read_u32(b + reader->size - 4u)) { return FRAME_BAD_CRC; }
  if (b[1] != FRAME_VERSION || b[2] != 0u || b[3] != 0u) { return FRAME_BAD_VERSION; }
  to->type = b[0];
  to->sequence = read_u32(b + 4);
  to->payload = b + FRAME_HEADER;
  to->payload_size = reader->size - FRAME_HEADER - FRAME_TRAILER;
  return FRAME_OK;
}

int frame_tag_valid(const frame *f, const siphash_key *key) {
  const uint8_t *tag = f->payload + f->payload_size;
  return siphash(key, f->payload - FRAME_HEADER, FRAME_HEADER + f->payload_size) == read_u64(tag);
}

/* COBS of `size` bytes with the delimiter; returns the number of bytes */
static uint32_t stuff(const uint8_t *from, uint32_t size, uint8_t *to) {
  uint32_t end = 1, code_at = 0;
  uint8_t code = 1;
  for (uint32_t i = 0; i < size; ++i) {
    if (from[i] != 0u) {
      to[end++] = from[i];
      ++code;
    }
    if (from[i] == 0u || code == 0xFFu) {
      to[code_at] = code;
      code = 1;
      code_at = end++;
    }
  }
  to[code_at] = code;
  to[end++] = 0;
  return end;
}

uint32_t frame_encode(uint8_t type, uint32_t sequence, const uint8_t *payload, uint32_t size, const siphash_key *key,
                      uint8_t *encoded) {
  uint8_t b[FRAME_MAX_BYTES];
  if (size > FRAME_MAX_PAYLOAD) { return 0; }
  b[0] = type;
  b[1] = FRAME_VERSION;
  b[2] = b[3] = 0;
  write_u32(b + 4, sequence);
  for (uint32_t i = 0; i < size; ++i) { b[FRAME_HEADER + i] = payload[i]; }
  write_u64(b + FRAME_HEADER + size, siphash(key, b, FRAME_HEADER + size));
  write_u32(b + FRAME_HEADER + size + 8u, frame_crc32(b, FRAME_HEADER + size + 8u));
  return stuff(b, FRAME_HEADER + size + FRAME_TRAILER, encoded);
}
