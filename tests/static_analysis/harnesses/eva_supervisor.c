/* Frama-C Eva: the state machine of the supervisor and the enforcement of its decisions, in an endless loop of updates with
 * arbitrary times, conditions and joint states. */
#include "dbk/dbk_standstill.h"
#include "dbk/dbk_supervisor.h"

#include "arbitrary.h"

static uint64_t arbitrary_long(void) { return (uint64_t)arbitrary_word << 32 | arbitrary_word; }

int main(void) {
  static dbk_supervisor supervisor;
  static dbk_standstill standstill;
  dbk_real q[DBK_MAX_DOF], v[DBK_MAX_DOF];
  dbk_supervisor_init(&supervisor);
  dbk_standstill_init(&standstill);
  while (arbitrary_word) {
    fill_arbitrary(q, DBK_MAX_DOF);
    fill_arbitrary(v, DBK_MAX_DOF);
    const dbk_decision decision = dbk_supervisor_update(&supervisor, arbitrary_long(), arbitrary_long());
    (void)dbk_standstill_apply(&standstill, decision, (int)(arbitrary_word & 1u), DBK_MAX_DOF, q, v, arbitrary_long());
    /*@ assert decision.action <= DBK_ACTION_LOCKOUT; */
    /*@ assert standstill.drive_wanted <= 1 && standstill.at_standstill <= 1; */
  }
  return 0;
}
