/* Closed loops and difficult states that together execute every line of the kernel. Each case computes a hash over all
 * bits of all results. A new case is one function and one line of the table in golden_cases.c. The cases do not print,
 * so they also run on a target without a console. */
#ifndef GOLDEN_CASES_H
#define GOLDEN_CASES_H

#include <stdint.h>

typedef struct {
  uint64_t hash;                    /* FNV-1a over all results */
  uint32_t count[5];                /* steps by status */
  uint32_t flags, relaxed;          /* union of the bits of all steps */
  int32_t iterations, rows, active; /* maxima per step */
} golden_result;

extern const int golden_count;
const char *golden_name(int index);
void golden_run(int index, golden_result *result);

#endif
