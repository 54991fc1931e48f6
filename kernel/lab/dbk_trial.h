/* A closed loop in which everything goes as wrong as its stated bounds allow, judged in float64 (dbk_judge).
 *
 * Plant: ydot = u + r with |r_k| <= push chosen against the nearest row, y = q + lag v, q a first-order lag of y (exact).
 * Measurement: |q_m - q| <= q_noise, |v_m - v| <= v_noise, at its worst against the nearest row, or random, by turns.
 * Scene: seen every `frame` periods with error norms <= place_noise and speed_noise; frames get lost, none is older than
 * `scene_longest` periods. State: bursts of lost frames, none longer than `state_longest`; with `reckon` the caller adds
 * the controls it has sent since. Late: the filter is not called and the last control stays. A mover that touches the
 * robot stops there and withdraws.
 */
#ifndef DBK_TRIAL_H
#define DBK_TRIAL_H

#include "dbk/dbk.h"
#include "dbk_judge.h"
#include "dbk_mover.h"

#ifdef __cplusplus
extern "C" {
#endif

/* premises of the invariance claim, as bits of what failed */
enum { DBK_NOT_FEASIBLE = 1, DBK_NOT_FRESH = 2, DBK_NOT_ON_TIME = 4, DBK_NOT_CERTIFIED = 8, DBK_PREMISES = 16 };

typedef struct {
  uint64_t seed;
  int32_t steps, hold;   /* the nominal control changes every `hold` periods */
  double toward;         /* share of choices straight down the worst barrier; the rest is bang-bang */
  double lag, push, q_noise, v_noise, place_noise, speed_noise;
  int32_t frame, scene_longest, state_longest, reckon;
  double scene_drop, state_drop, late; /* chances a frame, a step, a step */
  double told;                         /* share of a mover's velocity that the filter is told */
  dbk_mover_rules mover;
} dbk_trial;

typedef struct {
  int64_t steps, status[5], held[5];        /* held: steps on which feasible, fresh, on time, certified, all four held */
  int64_t still[DBK_PREMISES];              /* steps with h < 0: static things, own links, joint limits */
  int64_t moving[2][DBK_PREMISES];          /* steps of the robot's violation, by the plan's evadability */
  int64_t touched[2], plans[2], attacked[2]; /* steps with moving h < 0; plans; steps under a plan, by evadability */
  int64_t contacts[2], approaching[2];      /* times h became < 0, and those with own approach above 1 mm/s, by class */
  int64_t jerks;                            /* steps on which u left the acceleration box */
  int64_t iterations, rows;
  int32_t most_iterations, most_rows;
  double h_still, h_self, h_joint, h_moving[2], approach[2]; /* worst */
  int64_t worst_step;                                         /* of h_still */
} dbk_account;

/* q (n,) is the start, at rest, and the end; things[i] is the truth about scene->obstacle[i]; q_log (steps, n) or null */
void dbk_run_trial(const dbk_model *model, dbk_scene *scene, dbk_ctx *ctx, const dbk_judge_body *body, dbk_thing *things,
                   int32_t n_things, const dbk_trial *trial, double *q, double *q_log, dbk_account *account);

#ifdef __cplusplus
}
#endif
#endif
