/* Answers a robot over UDP, cycle by cycle, with the next joint angles of the field in motion.h.
 *
 *     ./bridge CYCLE      seconds from one datagram of the robot to the next
 *
 * Prints the port that it listens on, of the loopback, and ends when the robot says so, with status 0, or has been
 * silent for five seconds, with status 1. Both datagrams are 64 bytes in the machine's own order: a sequence number,
 * and the angles in rad, measured in the one and commanded in the other.
 *
 * The command is integrated from the last command. Integrated from the measured angles, which lag behind, the motion
 * would be slowed by the lag and shaken by the sensors' noise. What is measured counts twice: the first command starts
 * there, and the command waits while the arm is further behind than LEASH, because somebody holds it.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "motion.h"

#define STOP UINT64_MAX   /* a sequence number: end */
#define LEASH 0.2         /* rad, of any joint */
#define SOFT_START 0.5    /* s until the field's full speed, which is not zero at its start: arms reject a jump */

struct datagram {
    uint64_t sequence;
    double angles[motion_DIM];
};

static int all_finite(const double *angles) {
    for (int d = 0; d < motion_DIM; d++)
        if (!isfinite(angles[d])) return 0;
    return 1;
}

/* Move the command by one cycle, `time` s after the first; not at all while the arm is held. */
static void advance(double *command, const double *measured, double time, double cycle) {
    double velocity[motion_DIM];
    const double share = time < SOFT_START ? time / SOFT_START : 1;
    for (int d = 0; d < motion_DIM; d++)
        if (fabs(command[d] - measured[d]) > LEASH) return;
    motion_velocity(command, velocity);
    for (int d = 0; d < motion_DIM; d++) command[d] += cycle * share * velocity[d];
}

int main(int count, char **words) {
    double command[motion_DIM] = {0};
    const double cycle = count == 2 ? atof(words[1]) : 0;
    const int udp = socket(AF_INET, SOCK_DGRAM, 0);
    const struct timeval silence = {5, 0};
    struct sockaddr_in here = {0}, robot;
    socklen_t length = sizeof here;
    here.sin_family = AF_INET;
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK); /* there: the address of the card that the robot is wired to */
    if (!(cycle > 0) || udp < 0 || bind(udp, (struct sockaddr *)&here, sizeof here) != 0 ||
        getsockname(udp, (struct sockaddr *)&here, &length) != 0 ||
        setsockopt(udp, SOL_SOCKET, SO_RCVTIMEO, &silence, sizeof silence) != 0) {
        fprintf(stderr, "bridge: expected a cycle > 0 s and a free port\n");
        return 2;
    }
    printf("%d\n", ntohs(here.sin_port));
    fflush(stdout);

    for (uint64_t cycles = 0;;) {
        struct datagram in, out;
        char bytes[sizeof in + 1]; /* one more, so that a longer datagram is seen to be longer */
        length = sizeof robot;
        const ssize_t size = recvfrom(udp, bytes, sizeof bytes, 0, (struct sockaddr *)&robot, &length);
        if (size < 0 && errno == EINTR) continue;
        if (size < 0) return 1;
        if (size != (ssize_t)sizeof in) continue;
        memcpy(&in, bytes, sizeof in);
        if (in.sequence == STOP) break;
        if (!all_finite(in.angles)) continue;
        for (int d = 0; d < motion_DIM && cycles == 0; d++) command[d] = in.angles[d];
        advance(command, in.angles, (double)cycles++ * cycle, cycle);
        out.sequence = in.sequence;
        for (int d = 0; d < motion_DIM; d++) out.angles[d] = command[d];
        sendto(udp, &out, sizeof out, 0, (struct sockaddr *)&robot, length); /* lost or not: the next is on its way */
    }
    close(udp);
    return 0;
}
