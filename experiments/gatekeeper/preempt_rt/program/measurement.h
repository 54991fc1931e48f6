/* Punctuality of the ticks, from the records of the control loop.
 *
 *   due = start of the tick - its delay,   periods = (due of the last tick - due of the first one) / period + 1
 *
 * A period without a tick is missed. A record that the log has lost counts as missed, too.
 */
#ifndef MEASUREMENT_H
#define MEASUREMENT_H

#include "dbk_control_thread.h"

typedef struct {
  uint64_t first_due_us, last_due_us;
  uint32_t periods; /* to be measured */
  uint32_t ticks, late, moving, modified, max_work_us;
  uint32_t *delay_us; /* of each tick; room for `periods` */
} measurement;

/* adds the records that the log has until the last period; 1 if all periods have passed */
int measurement_read(measurement *m, dbk_control_loop *loop, const dbk_control_thread *thread);

/* periods that have passed */
uint32_t measurement_elapsed(const measurement *m, uint64_t period_us);

/* sorts the delays, for measurement_quantile */
void measurement_sort(measurement *m);

/* the delay [us] that a share of the ticks does not exceed */
uint32_t measurement_quantile(const measurement *m, double share);

#endif
