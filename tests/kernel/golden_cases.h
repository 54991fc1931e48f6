/* Closed loops and hard moments that together run every line of the kernel; each leaves a hash over every bit of every
 * answer. A new case is one function and one line of the table in cases.c. Nothing here prints: it also runs on a target
 * without a console. */
#ifndef CASES_H
#define CASES_H

#include <stdint.h>

typedef struct {
  uint64_t hash;    /* FNV-1a over all outputs */
  uint32_t count[5]; /* steps by status */
  uint32_t flags, relaxed; /* bits that were seen */
  int32_t iterations, rows, active; /* the most in one step */
} golden_result;

extern const int golden_count;
const char *golden_name(int index);
void golden_run(int index, golden_result *result);

#endif
