/* Gaps between two ticks; see dbk_loop_timing.h. */
#include "checks/dbk_loop_timing.h"

#include <math.h>

#include "dbk/dbk_conditions.h"

#define LATE_PERIODS 2.5
#define DECAY_TIME 0.2
#define MAX_DELAY 0.1

void dbk_loop_timing_init(dbk_loop_timing *t) {
  t->started = 0;
  t->now = t->stamp = t->delay = 0.0;
}

static double smaller(double a, double b) { return b < a ? b : a; }

/* the delay after a gap between two ticks by both clocks */
static void add_delay(dbk_loop_timing *t, double period, double gap, int moving) {
  const double late = moving && gap > LATE_PERIODS * period ? gap - period : 0.0;
  t->delay = smaller(MAX_DELAY, t->delay * exp(-gap / DECAY_TIME) + late);
}

uint64_t dbk_check_loop(dbk_loop_timing *t, const dbk_control_limits *limits, double now, double stamp, int moving) {
  const double period = limits->period, gap = now - t->now, common = smaller(gap, stamp - t->stamp);
  uint64_t flags = 0;
  if (t->started && gap > LATE_PERIODS * period) {
    flags |= DBK_CONDITION_TICK_OVERRUN;
    if (gap > limits->tick_lost_after) { flags |= DBK_CONDITION_TICK_LOST; }
  }
  add_delay(t, period, t->started && common > period ? common : period, moving);
  t->started = 1;
  t->now = now;
  t->stamp = stamp;
  return flags | (t->delay > limits->max_loop_delay ? DBK_CONDITION_LOOP_BEHIND : (uint64_t)0);
}
