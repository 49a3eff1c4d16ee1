/* A client of `evofsm monitor --socket PATH`: sends rows, prints the first alarm.
 *
 * cc -std=c99 -D_POSIX_C_SOURCE=200809L -o client client.c
 * evofsm monitor --socket /tmp/monitor.sock &
 * ./client /tmp/monitor.sock
 *
 * It closes in on a slower car, 10 rows a second of its own time. Answers come one for each row,
 * as one line of JSON; two of its keys are looked for, so that no library is needed.
 * It ends with 0 after an alarm, 1 where none came, 2 where the monitor cannot be reached.
 */
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

enum { LINE = 4096 };

static int connected_to(const char *path)
{
    struct sockaddr_un address;
    int peer = socket(AF_UNIX, SOCK_STREAM, 0);
    memset(&address, 0, sizeof address);
    address.sun_family = AF_UNIX;
    if (peer < 0 || strlen(path) >= sizeof address.sun_path)
        return -1;
    strcpy(address.sun_path, path);
    if (connect(peer, (struct sockaddr *)&address, sizeof address) != 0) {
        close(peer);
        return -1;
    }
    return peer;
}

static int send_all(int peer, const char *data, size_t size)
{
    while (size > 0) {
        ssize_t sent = write(peer, data, size);
        if (sent <= 0)
            return -1;
        data += sent;
        size -= (size_t)sent;
    }
    return 0;
}

/* Reads up to the end of a line; whatever is longer than the buffer is left out. */
static int read_line(int peer, char *line, size_t size)
{
    size_t length = 0;
    char letter;
    while (read(peer, &letter, 1) == 1) {
        if (letter == '\n') {
            line[length] = '\0';
            return 0;
        }
        if (length + 1 < size)
            line[length++] = letter;
    }
    return -1;
}

int main(int count, char **words)
{
    char line[LINE];
    double gap = 60.0, speed = 20.0, leader = 15.0, dt = 0.1;
    int peer, k;

    if (count != 2) {
        fprintf(stderr, "usage: %s SOCKET\n", words[0]);
        return 2;
    }
    peer = connected_to(words[1]);
    if (peer < 0) {
        perror(words[1]);
        return 2;
    }
    for (k = 0; k < 110; ++k) {
        int length = snprintf(line, sizeof line,
                              "{\"schema\":1,\"time\":%.3f,\"gap\":%.3f,\"v_follower\":%.3f,"
                              "\"v_leader\":%.3f,\"proposal\":0.0}\n",
                              k * dt, gap, speed, leader);
        if (send_all(peer, line, (size_t)length) != 0 || read_line(peer, line, sizeof line) != 0) {
            fprintf(stderr, "the monitor is gone\n");
            return 2;
        }
        if (strstr(line, "\"kind\":\"error\"") != NULL)
            fprintf(stderr, "refused: %s\n", line);
        if (strstr(line, "\"alarm\":true") != NULL) {
            printf("alarm at %.1f s, %.1f m behind: %s\n", k * dt, gap, line);
            close(peer);
            return 0;
        }
        gap -= (speed - leader) * dt;
    }
    printf("no alarm\n");
    close(peer);
    return 1;
}
