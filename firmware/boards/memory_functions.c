/* Memory functions that compilers call; the firmware links no C library. */
#include <stddef.h>
#include <stdint.h>

void *memcpy(void *restrict to, const void *restrict from, size_t size) {
  uint8_t *t = to;
  const uint8_t *f = from;
  for (size_t i = 0; i < size; ++i) { t[i] = f[i]; }
  return to;
}

void *memmove(void *to, const void *from, size_t size) {
  uint8_t *t = to;
  const uint8_t *f = from;
  if (t < f) {
    for (size_t i = 0; i < size; ++i) { t[i] = f[i]; }
  } else {
    for (size_t i = size; i > 0; --i) { t[i - 1] = f[i - 1]; }
  }
  return to;
}

void *memset(void *to, int value, size_t size) {
  uint8_t *t = to;
  for (size_t i = 0; i < size; ++i) { t[i] = (uint8_t)value; }
  return to;
}

/* names of the ARM run-time ABI */
void __aeabi_memcpy(void *to, const void *from, size_t size) { (void)memcpy(to, from, size); }
void __aeabi_memcpy4(void *to, const void *from, size_t size) { (void)memcpy(to, from, size); }
void __aeabi_memcpy8(void *to, const void *from, size_t size) { (void)memcpy(to, from, size); }
void __aeabi_memmove(void *to, const void *from, size_t size) { (void)memmove(to, from, size); }
void __aeabi_memmove4(void *to, const void *from, size_t size) { (void)memmove(to, from, size); }
void __aeabi_memmove8(void *to, const void *from, size_t size) { (void)memmove(to, from, size); }
void __aeabi_memset(void *to, size_t size, int value) { (void)memset(to, value, size); }
void __aeabi_memset4(void *to, size_t size, int value) { (void)memset(to, value, size); }
void __aeabi_memset8(void *to, size_t size, int value) { (void)memset(to, value, size); }
void __aeabi_memclr(void *to, size_t size) { (void)memset(to, 0, size); }
void __aeabi_memclr4(void *to, size_t size) { (void)memset(to, 0, size); }
void __aeabi_memclr8(void *to, size_t size) { (void)memset(to, 0, size); }
