/* Little-endian numbers in byte arrays, without alignment. */
#ifndef FIRMWARE_BYTES_H
#define FIRMWARE_BYTES_H

#include <stdint.h>

static inline uint16_t read_u16(const uint8_t *b) { return (uint16_t)(b[0] | ((uint16_t)b[1] << 8)); }

static inline uint32_t read_u32(const uint8_t *b) {
  return (uint32_t)b[0] | ((uint32_t)b[1] << 8) | ((uint32_t)b[2] << 16) | ((uint32_t)b[3] << 24);
}

static inline uint64_t read_u64(const uint8_t *b) { return (uint64_t)read_u32(b) | ((uint64_t)read_u32(b + 4) << 32); }

static inline float read_f32(const uint8_t *b) {
  const union {
    uint32_t bits;
    float value;
  } number = {read_u32(b)};
  return number.value;
}

static inline void write_u16(uint8_t *b, uint16_t x) {
  b[0] = (uint8_t)(x & 0xFFu);
  b[1] = (uint8_t)(x >> 8);
}

static inline void write_u32(uint8_t *b, uint32_t x) {
  for (unsigned i = 0; i < 4u; ++i) { b[i] = (uint8_t)((x >> (8u * i)) & 0xFFu); }
}

static inline void write_u64(uint8_t *b, uint64_t x) {
  write_u32(b, (uint32_t)(x & 0xFFFFFFFFu));
  write_u32(b + 4, (uint32_t)(x >> 32));
}

static inline void write_f32(uint8_t *b, float x) {
  union {
    float value;
    uint32_t bits;
  } number = {x};
  write_u32(b, number.bits);
}

#endif
