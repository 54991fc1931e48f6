/* The memory functions that compilers call, for programs without a C library. */
#include <stddef.h>
#include <stdint.h>

void *memcpy(void *restrict to, const void *restrict from, size_t count) {
  uint8_t *t = to;
  const uint8_t *f = from;
  for (; count >= 4; count -= 4, t += 4, f += 4) { *(uint32_t *)(void *)t = *(const uint32_t *)(const void *)f; }
  while (count-- > 0) { *t++ = *f++; }
  return to;
}

void *memmove(void *to, const void *from, size_t count) {
  uint8_t *t = to;
  const uint8_t *f = from;
  if (t <= f) { return memcpy(to, from, count); }
  while (count-- > 0) { t[count] = f[count]; }
  return to;
}

void *memset(void *to, int value, size_t count) {
  uint8_t *t = to;
  const uint32_t word = (uint32_t)(uint8_t)value * 0x01010101u;
  for (; count >= 4; count -= 4, t += 4) { *(uint32_t *)(void *)t = word; }
  while (count-- > 0) { *t++ = (uint8_t)value; }
  return to;
}

void __aeabi_memcpy(void *to, const void *from, size_t count) { (void)memcpy(to, from, count); }
void __aeabi_memcpy4(void *to, const void *from, size_t count) { (void)memcpy(to, from, count); }
void __aeabi_memcpy8(void *to, const void *from, size_t count) { (void)memcpy(to, from, count); }
void __aeabi_memmove(void *to, const void *from, size_t count) { (void)memmove(to, from, count); }
void __aeabi_memmove4(void *to, const void *from, size_t count) { (void)memmove(to, from, count); }
void __aeabi_memset(void *to, size_t count, int value) { (void)memset(to, value, count); }
void __aeabi_memclr(void *to, size_t count) { (void)memset(to, 0, count); }
void __aeabi_memclr4(void *to, size_t count) { (void)memset(to, 0, count); }
void __aeabi_memclr8(void *to, size_t count) { (void)memset(to, 0, count); }
