/* Mailbox of the latest value between one writer and one reader: three slots, without a lock and without waiting.
 *
 * The writer owns one slot, the reader another, and the third is exchanged. A value that is not read in time is replaced.
 * The caller has the slots; this is the index of each side.
 */
#ifndef DBK_LATEST_H
#define DBK_LATEST_H

#include <stdint.h>

#define DBK_LATEST_NEW 4u /* set in `shared` while its slot has not been read */

typedef struct {
  uint32_t shared, writing, reading;
} dbk_latest;

static inline void dbk_latest_init(dbk_latest *l) {
  l->reading = 0u;
  l->writing = 1u;
  l->shared = 2u;
}

/* the writer: publishes slot `writing`; `writing` is then another slot */
static inline void dbk_latest_publish(dbk_latest *l) {
  const uint32_t before = __atomic_exchange_n(&l->shared, l->writing | DBK_LATEST_NEW, __ATOMIC_ACQ_REL);
  l->writing = before & ~DBK_LATEST_NEW;
}

/* the reader: 1 if `reading` is now the slot of a newer value */
static inline int dbk_latest_take(dbk_latest *l) {
  if (!(__atomic_load_n(&l->shared, __ATOMIC_ACQUIRE) & DBK_LATEST_NEW)) { return 0; }
  l->reading = __atomic_exchange_n(&l->shared, l->reading, __ATOMIC_ACQ_REL) & ~DBK_LATEST_NEW;
  return 1;
}

#endif
