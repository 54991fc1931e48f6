/* SipHash-2-4; see siphash.h. */
#include "protocol/siphash.h"

typedef struct {
  uint64_t v0, v1, v2, v3;
} sip_state;

static uint64_t rotate(uint64_t x, unsigned bits) { return (x << bits) | (x >> (64u - bits)); }

static void sip_round(sip_state *s) {
  s->v0 += s->v1;
  s->v1 = rotate(s->v1, 13) ^ s->v0;
  s->v0 = rotate(s->v0, 32);
  s->v2 += s->v3;
  s->v3 = rotate(s->v3, 16) ^ s->v2;
  s->v0 += s->v3;
  s->v3 = rotate(s->v3, 21) ^ s->v0;
  s->v2 += s->v1;
  s->v1 = rotate(s->v1, 17) ^ s->v2;
  s->v2 = rotate(s->v2, 32);
}

static void absorb(sip_state *s, uint64_t word) {
  s->v3 ^= word;
  sip_round(s);
  sip_round(s);
  s->v0 ^= word;
}

uint64_t siphash(const siphash_key *key, const uint8_t *data, uint32_t size) {
  sip_state s = {key->low ^ UINT64_C(0x736f6d6570736575), key->high ^ UINT64_C(0x646f72616e646f6d),
                 key->low ^ UINT64_C(0x6c7967656e657261), key->high ^ UINT64_C(0x7465646279746573)};
  uint64_t word = 0;
  for (uint32_t i = 0; i < size; ++i) {
    word |= (uint64_t)data[i] << (8u * (i & 7u));
    if ((i & 7u) == 7u) {
      absorb(&s, word);
      word = 0;
    }
  }
  absorb(&s, word | ((uint64_t)(size & 0xFFu) << 56));
  s.v2 ^= 0xFFu;
  for (int i = 0; i < 4; ++i) { sip_round(&s); }
  return s.v0 ^ s.v1 ^ s.v2 ^ s.v3;
}
