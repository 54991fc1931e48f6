/* Punctuality of the ticks; see measurement.h. */
#include "measurement.h"

#include <math.h>
#include <stdlib.h>

static uint32_t is_moving(const dbk_tick_record *record) {
  uint32_t moving = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { moving |= fabs(record->u[k]) > 0.0; }
  return moving;
}

static void add(measurement *m, const dbk_tick_record *record, uint64_t late_limit_us) {
  m->last_due_us = record->now_us - record->wake_late_us;
  if (m->ticks == 0) { m->first_due_us = m->last_due_us; }
  m->delay_us[m->ticks++] = record->wake_late_us;
  m->late += record->wake_late_us > late_limit_us;
  m->moving += is_moving(record);
  m->modified += record->status != DBK_SAFE;
  if (record->work_us > m->max_work_us) { m->max_work_us = record->work_us; }
}

uint32_t measurement_elapsed(const measurement *m, uint64_t period_us) {
  return m->ticks == 0 ? 0u : (uint32_t)((m->last_due_us - m->first_due_us) / period_us) + 1u;
}

int measurement_read(measurement *m, dbk_control_loop *loop, const dbk_control_thread *thread) {
  dbk_tick_record record;
  while (measurement_elapsed(m, thread->period_us) < m->periods) {
    if (!dbk_ring_pop(&loop->log, &record)) { return 0; }
    add(m, &record, thread->late_limit_us);
  }
  return 1;
}

static int by_size(const void *a, const void *b) {
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return (x > y) - (x < y);
}

void measurement_sort(measurement *m) { qsort(m->delay_us, m->ticks, sizeof m->delay_us[0], by_size); }

uint32_t measurement_quantile(const measurement *m, double share) {
  return m->delay_us[(uint32_t)(share * (double)(m->ticks - 1u))];
}
