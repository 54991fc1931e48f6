/* Two threads exchange values over both mailboxes; a torn, repeated or reordered value ends the program with 1. */
#include <pthread.h>
#include <stdio.h>

#include "mailboxes/dbk_latest.h"
#include "mailboxes/dbk_ring.h"

#define COUNT 50000u
#define WORDS 20

typedef struct {
  uint64_t number, copies[WORDS];
} value;

static dbk_latest latest;
static value slots[3];
static dbk_ring ring;
static value memory[64];

static void fill(value *v, uint64_t number) {
  v->number = number;
  for (int i = 0; i < WORDS; ++i) { v->copies[i] = number; }
}

static int is_whole(const value *v) {
  int whole = 1;
  for (int i = 0; i < WORDS; ++i) { whole &= v->copies[i] == v->number; }
  return whole;
}

static void *write_all(void *unused) {
  for (uint64_t number = 1; number <= COUNT; ++number) {
    value v;
    fill(&slots[latest.writing], number);
    dbk_latest_publish(&latest);
    fill(&v, number);
    (void)dbk_ring_push(&ring, &v);
  }
  return unused;
}

int main(void) {
  pthread_t writer;
  uint64_t last = 0, last_of_ring = 0, read = 0;
  value v;
  dbk_latest_init(&latest);
  dbk_ring_init(&ring, memory, 64u, (uint32_t)sizeof memory[0]);
  pthread_create(&writer, NULL, write_all, NULL);
  while (last < COUNT) {
    if (dbk_latest_take(&latest)) {
      const value *newest = &slots[latest.reading];
      if (!is_whole(newest) || newest->number <= last) { return 1; }
      last = newest->number;
    }
    if (dbk_ring_pop(&ring, &v)) {
      if (!is_whole(&v) || v.number <= last_of_ring) { return 1; }
      last_of_ring = v.number;
      ++read;
    }
  }
  pthread_join(writer, NULL);
  while (dbk_ring_pop(&ring, &v)) { ++read; }
  return read + ring.dropped == COUNT ? 0 : 1;
}
