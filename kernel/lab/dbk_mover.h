/* A thing that comes at the robot, and the oracle that says whether the robot could have got away.
 *
 * The mover commits itself to a plan: its velocity goes to `target` with at most `acceleration` and stays there until
 * the plan ends. Between two plans it promises nothing but its speed and acceleration. A plan is called evadable when
 * one of a set of sampled controls, admissible from the robot's true state (velocity and acceleration limits, joint
 * limits), keeps the mover at `spare` or more and every other true h at 0 or more until the plan's end and the mover's
 * braking after it.
 */
#ifndef DBK_MOVER_H
#define DBK_MOVER_H

#include "dbk_judge.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  double speed, acceleration; /* stated bounds of the mover [m/s, m/s2] */
  double spare;               /* clearance from the mover that an escape must keep [m], at most DBK_JUDGE_NEAR */
  int32_t evadable;           /* 1: only plans with an escape are carried out; 0: only those without, where one is found */
} dbk_mover_rules;

typedef struct {
  double target[3];
  int32_t left, attack, evadable; /* periods left; whether it goes at the robot; what the oracle said */
} dbk_plan;

/* the next plan for things[at]; robot at q with joint velocity v */
void dbk_mover_plan(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const double *v,
                    const dbk_thing *things, int32_t n_things, int32_t at, double period, uint64_t *chance,
                    dbk_plan *plan);

/* one period of motion along the plan */
void dbk_mover_step(const dbk_mover_rules *rules, const dbk_plan *plan, double period, dbk_thing *thing);

/* does a sampled admissible control keep every h at `spare` until the plan is over and the mover has stopped? */
int32_t dbk_escape_exists(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const double *v,
                          const dbk_thing *things, int32_t n_things, int32_t at, double period, const dbk_plan *plan,
                          uint64_t *chance);

#ifdef __cplusplus
}
#endif
#endif
