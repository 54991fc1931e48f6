/* Messages that change the scene, the held object, the rows and the last control. */
#ifndef FIRMWARE_SCENE_MESSAGES_H
#define FIRMWARE_SCENE_MESSAGES_H

#include "executive/executive.h"

/* applies a message of one of these types. Returns 0 if it is refused; the scene is then unusable, and the robot brakes
 * until the next valid message of the same kind */
int scene_message_apply(executive *e, const frame *f);

/* Applies a RESET that waits, after the state of a CYCLE has been read and decided on. Returns 0 if it is refused. Its
 * control must be within the acceleration of RESET_PERIODS of the last control, of the measured velocity, or between
 * both. From HOVER on no joint may be faster than in both, unless the arm yields to a contact. */
int reset_apply(executive *e);

/* makes the obstacles unusable until the next complete SCENE_END */
void scene_make_unusable(executive *e);

#endif
