/* One cycle of the safety layer: conditions -> supervisor -> standstill and drive -> filter -> control.
 *
 *   u_nom = 0 from HOVER on,   u = 0 at a standstill and while the drive is off
 *
 * The firmware and the control thread run this code. The caller owns the memory and sets `in` before the cycle.
 */
#ifndef DBK_CYCLE_H
#define DBK_CYCLE_H

#include "dbk/dbk.h"
#include "dbk/dbk_standstill.h"
#include "dbk/dbk_supervisor.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  dbk_ctx ctx;
  dbk_in in;
  dbk_out out;
  dbk_supervisor supervisor;
  dbk_standstill standstill;
  uint64_t pending; /* conditions for the next decision */
  uint8_t yielding; /* the arm yields to a contact force */
} dbk_cycle;

void dbk_cycle_init(dbk_cycle *c);

/* The decision of this cycle from `conditions` and the pending ones, at the measured state `in` of `n` joints with the
 * stamp `stamp_us`. `may_yield`: the arm may move under a decision that an unexpected contact causes. */
dbk_decision dbk_cycle_decide(dbk_cycle *c, int32_t n, uint64_t now_us, uint64_t stamp_us, uint64_t conditions,
                              int may_yield);

/* The filter step under the decision in force. Returns 1 if `u` is the control of a standstill, which is zero. */
int dbk_cycle_filter(dbk_cycle *c, const dbk_model *model, const dbk_scene *scene, dbk_real u[DBK_MAX_DOF]);

/* restarts the filter at the last control `u`, which did not change in the last period */
void dbk_cycle_restart_filter(dbk_cycle *c, const dbk_real u[DBK_MAX_DOF]);

#ifdef __cplusplus
}
#endif
#endif
