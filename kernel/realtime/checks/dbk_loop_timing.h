/* Gaps between two ticks, and the delay that they add up to; as `LoopDelay` of `dualbrain.safety.supervisor`. */
#ifndef DBK_LOOP_TIMING_H
#define DBK_LOOP_TIMING_H

#include "dbk_control_data.h"

typedef struct {
  int32_t started;
  double now, stamp, delay; /* [s] */
} dbk_loop_timing;

void dbk_loop_timing_init(dbk_loop_timing *t);

/* conditions of a tick at `now` [s] with a state of `stamp` [s]; `moving`: the last command was not zero */
uint64_t dbk_check_loop(dbk_loop_timing *t, const dbk_control_limits *limits, double now, double stamp, int moving);

#endif
