/* SipHash-2-4: a keyed hash of short messages with 64 bits (Aumasson and Bernstein, 2012). */
#ifndef FIRMWARE_SIPHASH_H
#define FIRMWARE_SIPHASH_H

#include <stdint.h>

typedef struct {
  uint64_t low, high;
} siphash_key;

uint64_t siphash(const siphash_key *key, const uint8_t *data, uint32_t size);

#endif
