/* One cycle of the safety layer; see dbk_cycle.h. */
#include "dbk/dbk_cycle.h"

void dbk_cycle_init(dbk_cycle *c) {
  dbk_init(&c->ctx);
  dbk_supervisor_init(&c->supervisor);
  dbk_standstill_init(&c->standstill);
  c->pending = 0;
  c->yielding = 0;
}

/* conditions of the result of a step */
static uint64_t result_conditions(const dbk_out *out) {
  if (out->status < DBK_RELAXED) { return 0; }
  if (out->status == DBK_RELAXED) { return (out->flags & DBK_RETREAT) ? 0 : DBK_CONDITION_INFEASIBLE; }
  if (out->status == DBK_FAULT) { return DBK_CONDITION_FILTER_FAULT; }
  return (out->flags & ~DBK_JERK) == DBK_STALE_SCENE ? DBK_CONDITION_SCENE_STALE : DBK_CONDITION_FILTER_STOPPED;
}

/* 1 if an unexpected contact causes the decision */
static int contact_decides(dbk_decision decision) {
  return decision.check < DBK_N_CHECKS && dbk_checks[decision.check].condition == DBK_CONDITION_UNEXPECTED_CONTACT;
}

dbk_decision dbk_cycle_decide(dbk_cycle *c, int32_t n, uint64_t now_us, uint64_t stamp_us, uint64_t conditions,
                              int may_yield) {
  const dbk_decision decision = dbk_supervisor_update(&c->supervisor, now_us, conditions | c->pending);
  c->yielding = (uint8_t)(may_yield && contact_decides(decision));
  c->pending = dbk_standstill_apply(&c->standstill, decision, c->yielding, n, c->in.q, c->in.v, stamp_us);
  return decision;
}

void dbk_cycle_restart_filter(dbk_cycle *c, const dbk_real u[DBK_MAX_DOF]) {
  dbk_init(&c->ctx);
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { c->ctx.u_prev[k] = c->ctx.u_nom_prev[k] = u[k]; }
}

int dbk_cycle_filter(dbk_cycle *c, const dbk_model *model, const dbk_scene *scene, dbk_real u[DBK_MAX_DOF]) {
  if (c->supervisor.decision.action >= DBK_ACTION_HOVER && !c->yielding) {
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { c->in.u_nom[k] = (dbk_real)0; }
  }
  (void)dbk_step(model, scene, &c->ctx, &c->in, &c->out);
  c->pending |= result_conditions(&c->out);
  const int standstill = c->standstill.at_standstill || !c->standstill.drive_wanted;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { u[k] = standstill ? (dbk_real)0 : c->out.u[k]; }
  if (standstill) { dbk_cycle_restart_filter(c, u); }
  return standstill;
}
