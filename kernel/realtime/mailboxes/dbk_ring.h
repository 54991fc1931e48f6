/* Ring of records between one writer and one reader, without a lock and without waiting. A record that does not fit is
 * dropped and counted. The caller owns the memory: `capacity` records, a power of two.
 */
#ifndef DBK_RING_H
#define DBK_RING_H

#include <stdint.h>
#include <string.h>

typedef struct {
  uint8_t *memory;
  uint32_t capacity, record_size;
  uint64_t head; /* records written, by the writer only */
  uint64_t dropped;
  uint8_t other_cache_line[64];
  uint64_t tail; /* records read, by the reader only */
} dbk_ring;

static inline void dbk_ring_init(dbk_ring *r, void *memory, uint32_t capacity, uint32_t record_size) {
  r->memory = (uint8_t *)memory;
  r->capacity = capacity;
  r->record_size = record_size;
  r->head = r->tail = r->dropped = 0;
}

/* 1 if the record was written */
static inline int dbk_ring_push(dbk_ring *r, const void *record) {
  if (r->head - __atomic_load_n(&r->tail, __ATOMIC_ACQUIRE) >= r->capacity) {
    __atomic_fetch_add(&r->dropped, 1u, __ATOMIC_RELAXED);
    return 0;
  }
  memcpy(r->memory + (r->head & (r->capacity - 1u)) * r->record_size, record, r->record_size);
  __atomic_store_n(&r->head, r->head + 1u, __ATOMIC_RELEASE);
  return 1;
}

/* 1 if a record was read */
static inline int dbk_ring_pop(dbk_ring *r, void *record) {
  if (__atomic_load_n(&r->head, __ATOMIC_ACQUIRE) == r->tail) { return 0; }
  memcpy(record, r->memory + (r->tail & (r->capacity - 1u)) * r->record_size, r->record_size);
  __atomic_store_n(&r->tail, r->tail + 1u, __ATOMIC_RELEASE);
  return 1;
}

static inline uint64_t dbk_ring_size(const dbk_ring *r) {
  return __atomic_load_n(&r->head, __ATOMIC_ACQUIRE) - __atomic_load_n(&r->tail, __ATOMIC_ACQUIRE);
}

#endif
